"""From what is seen to where the part is."""
