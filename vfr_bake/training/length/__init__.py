"""Length of a training, decided by its errors at pixels that it does not learn from."""
