"""The numbers and figures of Trehan et al. 2025, from recorded slices."""
