"""What makes the daemon a service of the operating system: the files, where they go, and the memory it keeps."""
