"""The process: configuration, tasks, estimator, controller, safety, publisher, command line."""
