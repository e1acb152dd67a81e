"""Tests of single drivers use the helper modules and packages of this folder, which pytest searches
for modules because it has this file."""
