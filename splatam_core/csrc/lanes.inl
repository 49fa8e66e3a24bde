// Included once per instruction set, inside a namespace and a target region, after lanes_16.inl or lanes_32.inl. Uses
// no std templates: an inline function compiled here for a newer processor must never be the one the linker keeps for
// all.

static inline Lanes iota() { return to_float(int_iota()); }

static inline Lanes load(const float* from) {
  Lanes value;
  __builtin_memcpy(&value, from, sizeof value);
  return value;
}

static inline IntLanes load(const std::int32_t* from) {
  IntLanes value;
  __builtin_memcpy(&value, from, sizeof value);
  return value;
}

static inline void store(float* to, Lanes value) { __builtin_memcpy(to, &value, sizeof value); }

static inline void store(std::int32_t* to, IntLanes value) { __builtin_memcpy(to, &value, sizeof value); }

// Loads up to eight values; the lanes beyond are as in `rest`.
static inline Lanes load_some(const float* from, int count, Lanes rest) {
  if (count == 8) return load(from);
  float values[8];
  store(values, rest);
  for (int i = 0; i < count; ++i) values[i] = from[i];
  return load(values);
}

static inline Lanes absolute(Lanes x) { return from_bits(bits(x) & 0x7fffffff); }

// exp(x) for x up to 88: 2^n times the polynomial whose largest relative error on half an octave is least (1e-7).
static inline Lanes exp(Lanes x) {
  x = max(x * 1.44269504f, splat(-126.0f));
  const Lanes shifter = splat(12582912.0f);  // 1.5 * 2^23: adding it rounds to a whole number, in the lowest bits
  const Lanes shifted = x + shifter;
  const Lanes r = x - (shifted - shifter);
  Lanes p = splat(1.326472725e-3f);
  p = p * r + 9.671512688e-3f;
  p = p * r + 5.550733744e-2f;
  p = p * r + 0.2402224208f;
  p = p * r + 0.6931469776f;
  p = p * r + 1.0f;
  return p * from_bits((bits(shifted) + 127) << 23);
}

// Returns an upper bound of ln x, at most 0.012 above it, for normal x.
static inline Lanes log_bound(Lanes x) {
  const IntLanes raw = bits(x);
  const Lanes exponent = to_float((raw >> 23) - 127);
  const Lanes m = from_bits((raw & 0x007fffff) | 0x3f800000);  // [1, 2)
  const Lanes log2_m = (m - 1.0f) * (splat(1.68f) - 0.34f * m) + 0.009f;
  return (exponent + log2_m) * 0.693147181f;
}
