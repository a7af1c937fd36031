"""Make the products of a graph: store, workers, and run folders."""
