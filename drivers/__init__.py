"""Bytes to meaning and back, one folder per device; knows nothing of calibration."""
