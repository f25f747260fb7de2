"""Whole-body mobile manipulation learned in simulation."""

__version__ = "0.1.0"
