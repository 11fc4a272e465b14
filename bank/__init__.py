"""The EIT fingertip's physics: channels, mesh, forward models, basis models, bank file, matching. No clock."""
