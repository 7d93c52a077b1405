"""Learned tables that models are made of."""
