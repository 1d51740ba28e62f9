"""Pictures at the size that is trained on: held in memory where they are few, on the disk where they are
many."""
