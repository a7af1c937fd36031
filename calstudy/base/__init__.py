"""What every part builds on: errors, units, schema, data cubes, gains, this machine."""
