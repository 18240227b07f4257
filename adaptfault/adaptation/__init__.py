"""The adapter: reduced models, their stages, forecasts, files and baselines."""
