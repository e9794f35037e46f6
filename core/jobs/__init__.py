"""Long tasks: their states, jobs in processes of their own, and how work is stopped."""
