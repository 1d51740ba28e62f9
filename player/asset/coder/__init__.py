"""The entropy coder of the asset format: encodes small integers in few bytes, and decodes them."""
