"""Diagnosis of logs: findings, each with the settings that fix it."""
