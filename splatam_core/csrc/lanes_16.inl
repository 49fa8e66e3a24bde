// Eight lanes in two registers of 16 bytes: SSE2 and NEON have no wider ones. GCC takes wider vector types apart lane
// by lane there, so nothing here is wider than a register.

typedef float Half __attribute__((vector_size(16)));
typedef std::int32_t IntHalf __attribute__((vector_size(16)));

struct Lanes {
  Half low, high;
};

struct IntLanes {
  IntHalf low, high;
};

// min(a, b) and max(a, b) are b where a is NaN.
#if defined(__SSE2__)
static inline Half min(Half a, Half b) { return _mm_min_ps(a, b); }
static inline Half max(Half a, Half b) { return _mm_max_ps(a, b); }
static inline Half sqrt(Half x) { return _mm_sqrt_ps(x); }
static inline IntHalf truncated(Half x) { return (IntHalf)_mm_cvttps_epi32(x); }
static inline unsigned bits_of_mask(IntHalf mask) { return unsigned(_mm_movemask_ps((Half)mask)); }
static inline double sum(Half x) {
  const __m128d pairs = _mm_cvtps_pd(x) + _mm_cvtps_pd(_mm_movehl_ps(x, x));
  return _mm_cvtsd_f64(_mm_add_sd(pairs, _mm_unpackhi_pd(pairs, pairs)));
}
#elif defined(__aarch64__)
static inline Half min(Half a, Half b) { return vminnmq_f32(a, b); }
static inline Half max(Half a, Half b) { return vmaxnmq_f32(a, b); }
static inline Half sqrt(Half x) { return vsqrtq_f32(x); }
static inline IntHalf truncated(Half x) { return vcvtq_s32_f32(x); }
static inline unsigned bits_of_mask(IntHalf mask) { return unsigned(vaddvq_s32(mask & IntHalf{1, 2, 4, 8})); }
static inline double sum(Half x) { return vaddvq_f64(vaddq_f64(vcvt_f64_f32(vget_low_f32(x)), vcvt_high_f64_f32(x))); }
#else
static inline Half min(Half a, Half b) { return a < b ? a : b; }
static inline Half max(Half a, Half b) { return a > b ? a : b; }
static inline Half sqrt(Half x) {
  return Half{__builtin_sqrtf(x[0]), __builtin_sqrtf(x[1]), __builtin_sqrtf(x[2]), __builtin_sqrtf(x[3])};
}
static inline IntHalf truncated(Half x) { return __builtin_convertvector(x, IntHalf); }
static inline unsigned bits_of_mask(IntHalf mask) {
  return unsigned(mask[0] & 1) | unsigned(mask[1] & 2) | unsigned(mask[2] & 4) | unsigned(mask[3] & 8);
}
static inline double sum(Half x) { return (double(x[0]) + double(x[2])) + (double(x[1]) + double(x[3])); }
#endif

#define SPLATAM_LANEWISE(op)                                                                       \
  static inline Lanes operator op(Lanes a, Lanes b) { return {a.low op b.low, a.high op b.high}; } \
  static inline Lanes operator op(Lanes a, Half b) { return {a.low op b, a.high op b}; }           \
  static inline Lanes operator op(Lanes a, float b) { return {a.low op b, a.high op b}; }          \
  static inline Lanes operator op(float a, Lanes b) { return {a op b.low, a op b.high}; }
SPLATAM_LANEWISE(+)
SPLATAM_LANEWISE(-)
SPLATAM_LANEWISE(*)
SPLATAM_LANEWISE(/)
#undef SPLATAM_LANEWISE

#define SPLATAM_COMPARISON(op)                                                                        \
  static inline IntLanes operator op(Lanes a, Lanes b) { return {a.low op b.low, a.high op b.high}; } \
  static inline IntLanes operator op(Lanes a, float b) { return {a.low op b, a.high op b}; }
SPLATAM_COMPARISON(<)
SPLATAM_COMPARISON(<=)
SPLATAM_COMPARISON(>)
SPLATAM_COMPARISON(>=)
SPLATAM_COMPARISON(==)
SPLATAM_COMPARISON(!=)
#undef SPLATAM_COMPARISON

#define SPLATAM_INTEGER(op)                                                                                 \
  static inline IntLanes operator op(IntLanes a, IntLanes b) { return {a.low op b.low, a.high op b.high}; } \
  static inline IntLanes operator op(IntLanes a, std::int32_t b) { return {a.low op b, a.high op b}; }
SPLATAM_INTEGER(+)
SPLATAM_INTEGER(-)
SPLATAM_INTEGER(&)
SPLATAM_INTEGER(|)
SPLATAM_INTEGER(<<)
SPLATAM_INTEGER(>>)
#undef SPLATAM_INTEGER

static inline IntLanes operator<(IntLanes a, IntLanes b) { return {a.low < b.low, a.high < b.high}; }
static inline Lanes operator-(Lanes a) { return {-a.low, -a.high}; }
static inline Lanes& operator+=(Lanes& a, Lanes b) { return a = a + b; }
static inline Lanes& operator-=(Lanes& a, Lanes b) { return a = a - b; }
static inline Lanes& operator*=(Lanes& a, Lanes b) { return a = a * b; }
static inline Lanes& operator-=(Lanes& a, float b) { return a = a - b; }
static inline IntLanes& operator+=(IntLanes& a, IntLanes b) { return a = a + b; }
static inline IntLanes& operator-=(IntLanes& a, IntLanes b) { return a = a - b; }
static inline IntLanes& operator&=(IntLanes& a, IntLanes b) { return a = a & b; }
static inline IntLanes& operator|=(IntLanes& a, IntLanes b) { return a = a | b; }

// A value that is the same in every lane, as operand of lanes.
typedef Half Uniform;
static inline Uniform uniform(float value) { return Half{value, value, value, value}; }
static inline Uniform uniform_of_int(std::int32_t value) {
  return __builtin_convertvector((IntHalf{value, value, value, value}), Half);
}

static inline Lanes splat(float value) { return {uniform(value), uniform(value)}; }
static inline IntLanes splat_int(std::int32_t value) { return {IntHalf{} + value, IntHalf{} + value}; }
static inline IntLanes int_iota() { return {IntHalf{0, 1, 2, 3}, IntHalf{4, 5, 6, 7}}; }
static inline Lanes min(Lanes a, Lanes b) { return {min(a.low, b.low), min(a.high, b.high)}; }
static inline Lanes max(Lanes a, Lanes b) { return {max(a.low, b.low), max(a.high, b.high)}; }
static inline Lanes sqrt(Lanes x) { return {sqrt(x.low), sqrt(x.high)}; }
static inline IntLanes bits(Lanes x) { return {(IntHalf)x.low, (IntHalf)x.high}; }
static inline Lanes from_bits(IntLanes x) { return {(Half)x.low, (Half)x.high}; }
static inline IntLanes truncated(Lanes x) { return {truncated(x.low), truncated(x.high)}; }
static inline Lanes to_float(IntLanes x) {
  return {__builtin_convertvector(x.low, Half), __builtin_convertvector(x.high, Half)};
}
static inline Lanes keep(IntLanes mask, Lanes a) { return from_bits(mask & bits(a)); }
static inline Lanes either(IntLanes mask, Lanes a, Lanes b) {
  return {mask.low ? a.low : b.low, mask.high ? a.high : b.high};
}
static inline unsigned bits_of_mask(IntLanes mask) { return bits_of_mask(mask.low) | bits_of_mask(mask.high) << 4; }
static inline bool any(IntLanes mask) { return bits_of_mask(mask.low | mask.high) != 0; }
static inline int sum(IntLanes x) {
  const IntHalf both = x.low + x.high;
  return (both[0] + both[1]) + (both[2] + both[3]);
}
static inline double sum(Lanes x) { return sum(x.low) + sum(x.high); }

// Returns the highest lane, in every lane.
static inline Uniform highest(Lanes x) {
  const Half both = max(x.low, x.high), swapped = max(both, __builtin_shufflevector(both, both, 2, 3, 0, 1));
  return max(swapped, __builtin_shufflevector(swapped, swapped, 1, 0, 3, 2));
}

// Transposes in place: lane k of rows[i] becomes lane i of rows[k].
static inline void transpose(Half* rows) {
  const Half a = __builtin_shufflevector(rows[0], rows[1], 0, 4, 1, 5);
  const Half b = __builtin_shufflevector(rows[0], rows[1], 2, 6, 3, 7);
  const Half c = __builtin_shufflevector(rows[2], rows[3], 0, 4, 1, 5);
  const Half d = __builtin_shufflevector(rows[2], rows[3], 2, 6, 3, 7);
  rows[0] = __builtin_shufflevector(a, c, 0, 1, 4, 5), rows[1] = __builtin_shufflevector(a, c, 2, 3, 6, 7);
  rows[2] = __builtin_shufflevector(b, d, 0, 1, 4, 5), rows[3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
}

static inline void transpose(Lanes* rows) {
  Half quarters[4][4];  // upper left, upper right, lower left, lower right
  for (int i = 0; i < 4; ++i) {
    quarters[0][i] = rows[i].low, quarters[1][i] = rows[i].high;
    quarters[2][i] = rows[4 + i].low, quarters[3][i] = rows[4 + i].high;
  }
  for (int i = 0; i < 4; ++i) transpose(quarters[i]);
  for (int i = 0; i < 4; ++i)
    rows[i] = {quarters[0][i], quarters[2][i]}, rows[4 + i] = {quarters[1][i], quarters[3][i]};
}

static inline void load_triples(const float* from, Half* to) {
  Half a, b, c;
  __builtin_memcpy(&a, from, sizeof a);
  __builtin_memcpy(&b, from + 4, sizeof b);
  __builtin_memcpy(&c, from + 8, sizeof c);
  to[0] = __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 3, 6, 6), c, 0, 1, 2, 5);
  to[1] = __builtin_shufflevector(__builtin_shufflevector(a, b, 1, 4, 7, 7), c, 0, 1, 2, 6);
  to[2] = __builtin_shufflevector(__builtin_shufflevector(a, b, 2, 5, 5, 5), c, 0, 1, 4, 7);
}

// Loads eight times three values: lane i of to[k] is from[3 * i + k].
static inline void load_triples(const float* from, Lanes* to) {
  Half low[3], high[3];
  load_triples(from, low), load_triples(from + 12, high);
  for (int i = 0; i < 3; ++i) to[i] = {low[i], high[i]};
}

// Lane i of the result is the sum of the lanes of rows[i].
static inline Half row_sums(Half* rows) {
#if defined(__aarch64__)
  return vpaddq_f32(vpaddq_f32(rows[0], rows[1]), vpaddq_f32(rows[2], rows[3]));
#else
  transpose(rows);
  return (rows[0] + rows[1]) + (rows[2] + rows[3]);
#endif
}

static inline Lanes row_sums(const Lanes* rows) {
  Half halves[8];
  for (int i = 0; i < 8; ++i) halves[i] = rows[i].low + rows[i].high;
  return {row_sums(halves), row_sums(halves + 4)};
}

// One row of a tile at a time: more pixels than that do not fit into the registers of SSE2.
typedef Lanes Rows;
typedef IntLanes IntRows;
constexpr int kRows = 1;

template <typename MakeRow>
static inline Rows rows_of(const MakeRow& row) {
  return row(0);
}

static inline Lanes row_of(Rows rows, int) { return rows; }
static inline Rows repeated(Lanes row) { return row; }

typedef Rows FoldedRows;
static inline void add(FoldedRows& sum, Rows a) { sum += a; }
static inline void add_product(FoldedRows& sum, Rows a, Rows b) { sum += a * b; }
static inline Lanes folded(FoldedRows sum) { return sum; }
static inline Rows min(Rows a, float b) { return min(a, splat(b)); }
