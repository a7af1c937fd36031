"""Common foundations: errors, units, schema, data cubes, gains, and the resources of the machine."""
