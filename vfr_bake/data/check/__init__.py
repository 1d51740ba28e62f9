"""What a set of pictures is good for, said before the minutes of a training go."""
