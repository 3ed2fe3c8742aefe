"""Data-driven precomputed radiance transfer."""

__version__ = "0.1.0"
