"""Output for users: results, posteriors and status, printed, drawn and saved."""
