"""How much detail of what is stored the pictures need."""
