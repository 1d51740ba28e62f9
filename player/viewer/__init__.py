"""The interactive viewer, on viser: needs the extra `viewer`."""
