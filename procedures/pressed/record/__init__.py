"""What a trial records while its ticks run: positions, strips, force, detections, its reading."""
