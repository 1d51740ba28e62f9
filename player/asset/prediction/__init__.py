"""Prediction of a level's values from those of the next coarser level of a pyramid."""
