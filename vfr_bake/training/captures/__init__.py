"""What real captures have and a field has not: exposure that changes, and things that move."""
