"""Evaluation of papers' statements on finished runs, and the products with the verdicts."""
