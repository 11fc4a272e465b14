"""The shear skin's instruments, played: current source, scanner and converter board around one circuit."""
