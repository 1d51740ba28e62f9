"""How versions 3.x of the format store an asset: it is read, and no longer written."""
