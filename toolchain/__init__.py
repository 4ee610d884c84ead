"""The toolchain, which builds deployments of Bayesian machines from models (thesis 3.4)."""
