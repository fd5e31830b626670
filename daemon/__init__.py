"""What runs: configuration, service, routine, recorder, control socket and command line."""
