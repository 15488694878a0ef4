"""The running loop: clock, episode and record."""
