"""The process wall: executors, the worker process, the tasks that cross it."""
