// Eight lanes in one register of 32 bytes: AVX2 and AVX-512.

typedef float Lanes __attribute__((vector_size(32)));
typedef std::int32_t IntLanes __attribute__((vector_size(32)));

// A value that is the same in every lane, as operand of lanes.
typedef float Uniform;
static inline Uniform uniform(float value) { return value; }
static inline Uniform uniform_of_int(std::int32_t value) { return float(value); }

static inline Lanes splat(float x) { return Lanes{x, x, x, x, x, x, x, x}; }
static inline IntLanes splat_int(std::int32_t value) { return IntLanes{} + value; }
static inline IntLanes int_iota() { return IntLanes{0, 1, 2, 3, 4, 5, 6, 7}; }
static inline Lanes min(Lanes a, Lanes b) { return a < b ? a : b; }  // b where a is NaN
static inline Lanes max(Lanes a, Lanes b) { return a > b ? a : b; }  // b where a is NaN
static inline IntLanes bits(Lanes x) { return (IntLanes)x; }
static inline Lanes from_bits(IntLanes x) { return (Lanes)x; }
static inline IntLanes truncated(Lanes x) { return __builtin_convertvector(x, IntLanes); }
static inline Lanes to_float(IntLanes x) { return __builtin_convertvector(x, Lanes); }
static inline Lanes keep(IntLanes mask, Lanes a) { return mask ? a : Lanes{}; }
static inline Lanes either(IntLanes mask, Lanes a, Lanes b) { return mask ? a : b; }

static inline unsigned bits_of_mask(IntLanes mask) { return unsigned(__builtin_ia32_movmskps256((Lanes)mask)); }
static inline bool any(IntLanes mask) { return bits_of_mask(mask) != 0; }
static inline int sum(IntLanes x) {
  int total = 0;
  for (int i = 0; i < 8; ++i) total += x[i];
  return total;
}

static inline Lanes sqrt(Lanes x) {
  Lanes root;
  for (int i = 0; i < 8; ++i) root[i] = __builtin_sqrtf(x[i]);
  return root;
}

static inline double sum(Lanes x) {
  typedef double Doubles __attribute__((vector_size(32)));
  const Doubles both = __builtin_convertvector(__builtin_shufflevector(x, x, 0, 1, 2, 3), Doubles) +
                       __builtin_convertvector(__builtin_shufflevector(x, x, 4, 5, 6, 7), Doubles);
  return (both[0] + both[2]) + (both[1] + both[3]);
}

// Transposes in place: lane k of rows[i] becomes lane i of rows[k].
static inline void transpose(Lanes* rows) {
  Lanes a[8], b[8];
  for (int i = 0; i < 8; i += 2) {
    a[i] = __builtin_shufflevector(rows[i], rows[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    a[i + 1] = __builtin_shufflevector(rows[i], rows[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
  for (int i = 0; i < 8; i += 4)
    for (int k = 0; k < 2; ++k) {
      b[i + k] = __builtin_shufflevector(a[i + k], a[i + k + 2], 0, 1, 8, 9, 4, 5, 12, 13);
      b[i + k + 2] = __builtin_shufflevector(a[i + k], a[i + k + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    }
  for (int k = 0; k < 4; ++k) {
    rows[k] = __builtin_shufflevector(b[k], b[k + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    rows[k + 4] = __builtin_shufflevector(b[k], b[k + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
}

// Loads eight times three values: lane i of to[k] is from[3 * i + k].
static inline void load_triples(const float* from, Lanes* to) {
  Lanes a, b, c;
  __builtin_memcpy(&a, from, sizeof a);
  __builtin_memcpy(&b, from + 8, sizeof b);
  __builtin_memcpy(&c, from + 16, sizeof c);
  const Lanes x =
      __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 9, 2, 3, 12, 5, 6, 15), c, 0, 1, 10, 3, 4, 13, 6, 7);
  const Lanes y =
      __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 1, 10, 3, 4, 13, 6, 7), c, 8, 1, 2, 11, 4, 5, 14, 7);
  const Lanes z =
      __builtin_shufflevector(__builtin_shufflevector(a, b, 8, 1, 2, 11, 4, 5, 14, 7), c, 0, 9, 2, 3, 12, 5, 6, 15);
  to[0] = __builtin_shufflevector(x, x, 0, 3, 6, 1, 4, 7, 2, 5);
  to[1] = __builtin_shufflevector(y, y, 1, 4, 7, 2, 5, 0, 3, 6);
  to[2] = __builtin_shufflevector(z, z, 2, 5, 0, 3, 6, 1, 4, 7);
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

// Returns the highest lane.
static inline Uniform highest(Lanes x) {
  const Lanes a = max(x, __builtin_shufflevector(x, x, 4, 5, 6, 7, 0, 1, 2, 3));
  const Lanes b = max(a, __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
  return b[0] > b[1] ? b[0] : b[1];
}

// Two rows of a tile at a time, the upper one first: one register if the processor has registers of that size, else
// two.
constexpr int kRows = 2;
#if SPLATAM_PAIRED
typedef float Rows __attribute__((vector_size(64)));
typedef std::int32_t IntRows __attribute__((vector_size(64)));

static inline Rows pair(Lanes upper, Lanes lower) {
  return __builtin_shufflevector(upper, lower, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}

static inline Lanes upper(Rows rows) { return __builtin_shufflevector(rows, rows, 0, 1, 2, 3, 4, 5, 6, 7); }

static inline Lanes lower(Rows rows) { return __builtin_shufflevector(rows, rows, 8, 9, 10, 11, 12, 13, 14, 15); }

static inline Rows min(Rows a, float b) { return a < b ? a : Rows{} + b; }

static inline Rows either(IntRows mask, Rows a, Rows b) { return mask ? a : b; }

static inline bool any(IntRows mask) {
  return any(__builtin_shufflevector(mask, mask, 0, 1, 2, 3, 4, 5, 6, 7) |
             __builtin_shufflevector(mask, mask, 8, 9, 10, 11, 12, 13, 14, 15));
}

// A sum whose rows are added at the end.
typedef Rows FoldedRows;
static inline void add(FoldedRows& sum, Rows a) { sum += a; }
static inline void add_product(FoldedRows& sum, Rows a, Rows b) { sum += a * b; }
static inline Lanes folded(FoldedRows sum) { return upper(sum) + lower(sum); }
#else
struct Rows {
  Lanes upper, lower;
};

struct IntRows {
  IntLanes upper, lower;
};

static inline Rows pair(Lanes upper, Lanes lower) { return {upper, lower}; }

static inline Lanes upper(Rows rows) { return rows.upper; }

static inline Lanes lower(Rows rows) { return rows.lower; }

static inline Rows operator+(Rows a, Rows b) { return {a.upper + b.upper, a.lower + b.lower}; }
static inline Rows operator-(Rows a, Rows b) { return {a.upper - b.upper, a.lower - b.lower}; }
static inline Rows operator*(Rows a, Rows b) { return {a.upper * b.upper, a.lower * b.lower}; }
static inline Rows operator+(Rows a, float b) { return {a.upper + b, a.lower + b}; }
static inline Rows operator-(float a, Rows b) { return {a - b.upper, a - b.lower}; }
static inline Rows operator*(Rows a, float b) { return {a.upper * b, a.lower * b}; }
static inline Rows& operator+=(Rows& a, Rows b) { return a = a + b; }
static inline Rows& operator*=(Rows& a, Rows b) { return a = a * b; }
static inline IntRows operator>=(Rows a, float b) { return {a.upper >= b, a.lower >= b}; }
static inline IntRows operator<(Rows a, float b) { return {a.upper < b, a.lower < b}; }
static inline IntRows& operator|=(IntRows& a, IntRows b) { return a = {a.upper | b.upper, a.lower | b.lower}; }

static inline Rows min(Rows a, float b) { return {min(a.upper, splat(b)), min(a.lower, splat(b))}; }

static inline Rows either(IntRows mask, Rows a, Rows b) {
  return {mask.upper ? a.upper : b.upper, mask.lower ? a.lower : b.lower};
}

static inline bool any(IntRows mask) { return any(mask.upper | mask.lower); }

// A sum whose rows are added at once: sums of two registers each would not fit the registers.
typedef Lanes FoldedRows;
static inline void add(FoldedRows& sum, Rows a) { sum += a.upper, sum += a.lower; }
static inline void add_product(FoldedRows& sum, Rows a, Rows b) { sum += a.upper * b.upper, sum += a.lower * b.lower; }
static inline Lanes folded(FoldedRows sum) { return sum; }
#endif

static inline Rows keep(IntRows mask, Rows a) { return either(mask, a, Rows{}); }

// Returns rows whose row i is row(i).
template <typename MakeRow>
static inline Rows rows_of(const MakeRow& row) {
  return pair(row(0), row(1));
}

static inline Lanes row_of(Rows rows, int index) { return index == 0 ? upper(rows) : lower(rows); }
static inline Rows repeated(Lanes row) { return pair(row, row); }
