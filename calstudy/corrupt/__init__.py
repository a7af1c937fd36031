"""Effects that an instrument has on visibilities: gain errors and other corruptions, and thermal noise."""
