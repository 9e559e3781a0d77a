"""Estimation of landmarks from keyframes with given poses."""
