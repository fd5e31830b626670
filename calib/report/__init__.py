"""What a calibration looks like: simulated rigs, tables and plots."""
