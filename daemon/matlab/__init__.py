"""The paper's MATLAB files: matrices checked byte by byte, recordings as arrays with units, slices written as such."""
