"""From posed pictures to a trained field."""
