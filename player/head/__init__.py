"""The head: its one graph, the file that holds it, and how it is run."""
