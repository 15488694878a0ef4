"""Figures and tables of what was planned and measured."""
