"""Arrays in, arrays out: the pose of a range sensor from a pole and the ground it stands on."""
