"""The head: its graph, the file that holds it, and the code that runs it."""
