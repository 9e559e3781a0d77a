"""Observers of a run: recorder, live view, report and exports."""
