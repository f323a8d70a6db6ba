"""The default model: ray samples, aggregation, depth distribution, blending; and the ray fill."""
