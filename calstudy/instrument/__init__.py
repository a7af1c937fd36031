"""The instrument: antenna layouts, beams, and the frequencies, times and baselines that it observes."""
