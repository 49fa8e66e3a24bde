// Included once per instruction set, inside a namespace and a target region. Uses no std templates: an inline
// function compiled here for a newer processor must never be the one the linker keeps for all.

typedef float Lanes __attribute__((vector_size(32)));
typedef std::int32_t IntLanes __attribute__((vector_size(32)));

static inline Lanes splat(float value) { return Lanes{} + value; }

static inline Lanes iota() { return Lanes{0, 1, 2, 3, 4, 5, 6, 7}; }

static inline Lanes min(Lanes a, Lanes b) { return a < b ? a : b; }

static inline Lanes max(Lanes a, Lanes b) { return a > b ? a : b; }

static inline Lanes load(const float* from) {
  Lanes value;
  __builtin_memcpy(&value, from, sizeof value);
  return value;
}

static inline void store(float* to, Lanes value) { __builtin_memcpy(to, &value, sizeof value); }

// exp(x) for x up to 88: 2^n times a Taylor polynomial on half an octave (relative error about 1e-7).
static inline Lanes exp(Lanes x) {
  x = max(x, splat(-87.0f));
  const Lanes shifter = splat(12582912.0f);  // 1.5 * 2^23: adding it rounds to a whole number
  const Lanes n = (x * 1.44269504f + shifter) - shifter;
  const Lanes r = (x - n * 0.693359375f) + n * 2.12194440e-4f;  // ln 2 in two parts
  Lanes p = splat(1.0f / 720);
  p = p * r + 1.0f / 120;
  p = p * r + 1.0f / 24;
  p = p * r + 1.0f / 6;
  p = p * r + 0.5f;
  p = p * r + 1.0f;
  p = p * r + 1.0f;
  return p * (Lanes)((__builtin_convertvector(n, IntLanes) + 127) << 23);
}

// Returns an upper bound of ln x, at most 0.012 above it, for normal x.
static inline Lanes log_bound(Lanes x) {
  const IntLanes bits = (IntLanes)x;
  const Lanes exponent = __builtin_convertvector((bits >> 23) - 127, Lanes);
  const Lanes m = (Lanes)((bits & 0x007fffff) | 0x3f800000);  // [1, 2)
  const Lanes log2_m = (m - 1.0f) * (splat(1.68f) - 0.34f * m) + 0.009f;
  return (exponent + log2_m) * 0.693147181f;
}

static inline Lanes keep(IntLanes mask, Lanes a) { return mask ? a : Lanes{}; }

// Two rows of eight, the upper one first: one register if the processor has registers of that size, else two.
#if SPLATAM_PAIRED
typedef float Pair __attribute__((vector_size(64)));
typedef std::int32_t IntPair __attribute__((vector_size(64)));

static inline Pair pair(Lanes upper, Lanes lower) {
  return __builtin_shufflevector(upper, lower, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}

static inline Lanes upper(Pair rows) { return __builtin_shufflevector(rows, rows, 0, 1, 2, 3, 4, 5, 6, 7); }

static inline Lanes lower(Pair rows) { return __builtin_shufflevector(rows, rows, 8, 9, 10, 11, 12, 13, 14, 15); }

static inline Pair min(Pair a, float b) { return a < b ? a : Pair{} + b; }

static inline Pair either(IntPair mask, Pair a, Pair b) { return mask ? a : b; }

static inline bool any(IntPair mask) {
  std::int32_t bits = 0;
  for (int i = 0; i < 16; ++i) bits |= mask[i];
  return bits != 0;
}
#else
struct Pair {
  Lanes upper, lower;
};

struct IntPair {
  IntLanes upper, lower;
};

static inline Pair pair(Lanes upper, Lanes lower) { return {upper, lower}; }

static inline Lanes upper(Pair rows) { return rows.upper; }

static inline Lanes lower(Pair rows) { return rows.lower; }

static inline Pair operator+(Pair a, Pair b) { return {a.upper + b.upper, a.lower + b.lower}; }
static inline Pair operator-(Pair a, Pair b) { return {a.upper - b.upper, a.lower - b.lower}; }
static inline Pair operator*(Pair a, Pair b) { return {a.upper * b.upper, a.lower * b.lower}; }
static inline Pair operator/(Pair a, Pair b) { return {a.upper / b.upper, a.lower / b.lower}; }
static inline Pair operator+(Pair a, float b) { return {a.upper + b, a.lower + b}; }
static inline Pair operator-(float a, Pair b) { return {a - b.upper, a - b.lower}; }
static inline Pair operator*(Pair a, float b) { return {a.upper * b, a.lower * b}; }
static inline Pair& operator+=(Pair& a, Pair b) { return a = a + b; }
static inline Pair& operator-=(Pair& a, Pair b) { return a = a - b; }
static inline Pair& operator*=(Pair& a, Pair b) { return a = a * b; }
static inline IntPair operator>=(Pair a, float b) { return {a.upper >= b, a.lower >= b}; }
static inline IntPair operator<=(Pair a, float b) { return {a.upper <= b, a.lower <= b}; }
static inline IntPair operator&(IntPair a, IntPair b) { return {a.upper & b.upper, a.lower & b.lower}; }
static inline IntPair& operator|=(IntPair& a, IntPair b) { return a = {a.upper | b.upper, a.lower | b.lower}; }

static inline Pair min(Pair a, float b) { return {min(a.upper, splat(b)), min(a.lower, splat(b))}; }

static inline Pair either(IntPair mask, Pair a, Pair b) {
  return {mask.upper ? a.upper : b.upper, mask.lower ? a.lower : b.lower};
}

static inline bool any(IntPair mask) {
  const IntLanes both = mask.upper | mask.lower;
  std::int32_t bits = 0;
  for (int i = 0; i < 8; ++i) bits |= both[i];
  return bits != 0;
}
#endif

static inline Pair pair(float upper, float lower) { return pair(splat(upper), splat(lower)); }

static inline Pair keep(IntPair mask, Pair a) { return either(mask, a, Pair{}); }

static inline Lanes sqrt(Lanes x) {
  Lanes root;
  for (int i = 0; i < 8; ++i) root[i] = __builtin_sqrtf(x[i]);
  return root;
}

// Lane i of the result is the sum of the lanes of rows[i].
static inline Lanes row_sums(const Lanes* rows) {
  Lanes a[4], b[2];
  for (int i = 0; i < 4; ++i)
    a[i] = __builtin_shufflevector(rows[2 * i], rows[2 * i + 1], 0, 8, 2, 10, 4, 12, 6, 14) +
           __builtin_shufflevector(rows[2 * i], rows[2 * i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  for (int i = 0; i < 2; ++i)
    b[i] = __builtin_shufflevector(a[2 * i], a[2 * i + 1], 0, 1, 8, 9, 4, 5, 12, 13) +
           __builtin_shufflevector(a[2 * i], a[2 * i + 1], 2, 3, 10, 11, 6, 7, 14, 15);
  return __builtin_shufflevector(b[0], b[1], 0, 1, 2, 3, 8, 9, 10, 11) +
         __builtin_shufflevector(b[0], b[1], 4, 5, 6, 7, 12, 13, 14, 15);
}
