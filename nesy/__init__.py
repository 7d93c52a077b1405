"""Perspective-shifted neuro-symbolic world models: learn, extract, query, explain."""

__version__ = "0.1.0"
