"""Corrections to the models that the mapper builds: folds are found, and parts are joined."""
