"""The front of the service: takes clients' connections, in a process of its own before the one that serves the API."""
