"""The service: rig orchestration, store, jobs, HTTP API and command line."""
