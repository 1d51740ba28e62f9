"""Reading of assets in versions 3.x of the format, which are no longer written."""
