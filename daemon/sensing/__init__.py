"""The EIT fingertips in the daemon: estimators, how they are opened, and the tasks of one fingertip and of both."""
