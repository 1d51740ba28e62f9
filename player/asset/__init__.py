"""The asset: its manifest, its packed arrays and the sparse grid that they become."""
