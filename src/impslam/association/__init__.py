"""Data association: match observations with landmarks."""
