"""A force sensor with one axis: 400 numbered frames/s in gram-force, over TCP."""
