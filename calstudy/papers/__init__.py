"""Papers with published statements that runs are compared with: one module or package each."""
