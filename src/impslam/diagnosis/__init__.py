"""What is wrong with a log, by its data: findings, each with the setting that fixes it."""
