"""Measurements of blur, and the pictures that repeat another one: before anything is learned from them."""
