"""What figures share: the journal style, panels, axes over baseline length and delay, files."""
