"""Neural inference of a simulator's fidelity: data, encoders, posteriors, anomaly detection. No MuJoCo here."""
