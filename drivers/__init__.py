"""Thin instrument drivers: one module an instrument model, between its protocol and its role."""
