"""Papers whose published statements runs are compared with: one module or package each."""
