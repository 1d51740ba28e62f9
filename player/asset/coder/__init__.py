"""The entropy coder of the asset format: small integers in few bytes, and back."""
