"""The four commands of this package, each from its parsed options to its exit code."""
