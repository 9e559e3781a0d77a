"""Many runs: logs x configs x settings x seeds to one table, on the processes of one or more machines."""
