"""How long a training takes, by its errors at pixels that it does not learn from."""
