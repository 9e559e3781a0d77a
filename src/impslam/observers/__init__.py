"""What looks at a run: recorder, plots."""
