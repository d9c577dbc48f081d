"""Static site of results: suite versions with their rankings, robots, methods, submissions."""
