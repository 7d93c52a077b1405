"""Perspective-shifted neuro-symbolic world models: learn, extract, query, explain.

Importing the package registers the Gymnasium ids of `domains`, and does nothing else.
"""

import domains  # noqa: F401

__version__ = "0.1.0"
