"""Extractors of landmarks from scans."""
