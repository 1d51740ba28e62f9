"""How an asset's surface is found, and the colours that it gets."""
