"""Train Volume Feature Rendering fields and bake them into assets that `player` shows on a CPU."""
