"""Assembly of consistent states, integration in time, and the solution."""
