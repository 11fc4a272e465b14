"""The EIT fingertip: channels, mesh, forward models, basis models, banks and matching."""
