"""The worker service: it joins a run, scores jobs, and delivers each result until it is acknowledged."""
