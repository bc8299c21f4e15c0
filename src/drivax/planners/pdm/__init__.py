"""PDM-Closed (Dauner et al. 2023): proposals, forecast, scoring and emergency brake."""
