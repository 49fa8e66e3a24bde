// The backward pass of the projection, of one splat (Value is float) or of eight (Lanes). Included by the engine, and
// once per instruction set.

// Returns the gradient by a Gaussian's parameters: a SplatGradient passed back through the projection.
template <typename Value>
static inline GaussianGradient<Value> through_projection(const BasicSplat<Value>& s, const BasicSplatGradient<Value>& g,
                                                         const Camera& camera) {
  const Value inverse_z = 1.0f / s.z;
  const Value inverse_variance = -2.0f * s.falloff, variance = 1.0f / inverse_variance;
  const Value du = g.dx * inverse_variance, dv = g.dy * inverse_variance;  // dx is pixel minus centre
  const Value dvariance = 0.5f * g.squared * inverse_variance * inverse_variance;
  const Value spread = 2.0f * (variance - kBlur);  // d variance / d log scale
  const Value x_over_z = (s.u - camera.cx) / camera.fx, y_over_z = (s.v - camera.cy) / camera.fy;
  const Value dx = du * camera.fx * inverse_z, dy = dv * camera.fy * inverse_z;
  const Value dz = g.z - dx * x_over_z - dy * y_over_z - dvariance * spread * inverse_z;
  return {{dx, dy, dz}, dvariance * spread, g.log_alpha * (1.0f - s.opacity)};
}
