"""Reporting on a batch: status, heartbeat file, notifications."""
