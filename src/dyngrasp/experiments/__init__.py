"""Scenarios, seeded trials and the metrics that judge them."""
