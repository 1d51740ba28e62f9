"""Training: from posed pictures to a trained field."""
