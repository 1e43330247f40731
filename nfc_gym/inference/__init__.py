"""Neural inference of a simulator's fidelity: training data, encoders, posteriors, anomaly detection. No MuJoCo here."""
