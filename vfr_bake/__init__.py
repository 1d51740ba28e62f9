"""Train Volume Feature Rendering fields and bake them into assets that `player` shows on a CPU."""

__version__ = "0.1.0"
