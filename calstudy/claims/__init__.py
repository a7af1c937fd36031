"""What finished runs show to the statements of papers, and the products that hold the verdicts."""
