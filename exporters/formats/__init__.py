"""File formats, one per module: functions from arrays to bytes, and back for comparison."""
