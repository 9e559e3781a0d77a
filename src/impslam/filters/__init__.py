"""Filters: the joint belief over robot and landmarks."""
