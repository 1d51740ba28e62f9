"""Measurement of the trade between speed and accuracy of baked assets: `vfr-bench`."""
