"""Effects of real captures that a field cannot show: exposure that changes, and things that move."""
