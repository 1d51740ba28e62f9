"""Measurements of the quality of pictures, made before anything is learned from them."""
