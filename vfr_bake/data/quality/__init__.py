"""What is measured of pictures before anything is learned from them."""
