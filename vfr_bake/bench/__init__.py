"""The trade between speed and accuracy of baked assets, measured: `vfr-bench`."""
