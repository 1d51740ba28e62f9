"""Extraction of an asset's surface, and the colours that it gets."""
