"""Arrays in, bytes out: one format, one file. numpy only; a heavier library is imported by the function that
needs it.
"""
