"""Computing the numbers and figures of Trehan et al. 2025 anew, from slices of recordings."""
