// Two dense layers with relu on each row of a set, then the maximum over valid rows (and zero).
//
// The second bias and relu are applied after the maximum. Masked rows cost nothing: rows are gathered, valid ones only,
// in blocks that fill the registers. The backward pass computes the hidden layer again for rows that won a maximum.
#include "kernel.h"

namespace drivax {

struct SetEncoder {
  const float* rows;     // [batch, count, inputs]
  const float* kernel1;  // [inputs, width]
  const float* bias1;    // [width]
  const float* kernel2;  // [width, width]
  const float* bias2;    // [width]
  int64_t count = -1, inputs = -1, width = -1;
};

struct SetEncoderForward : SetEncoder {
  Mask valid;         // [batch, count]
  float* output;      // [batch, width]
  int32_t* winner;    // [batch, width]: row of the maximum; -1 if the output is 0; -2 - row if it is NaN
};

struct SetEncoderBackward : SetEncoder {
  const int32_t* winner;   // as above
  const float* gradient;   // [batch, width]
  float* kernel1_gradient;
  float* bias1_gradient;
  float* kernel2_gradient;
  float* bias2_gradient;
  int32_t* place;          // [count], scratch
};

EACH_TARGET(void encode_sets(const SetEncoderForward& arguments, int64_t first, int64_t last);
            void differentiate_sets(const SetEncoderBackward& arguments, int64_t first, int64_t last);)

}  // namespace drivax

#ifdef TARGET

namespace drivax::TARGET {

// Rows that are multiplied at once with two vectors of columns: as many as registers hold.
constexpr int kBlock = LANES == 16 ? 8 : 6;
// Rows of the first kernel's gradient that are summed at once.
constexpr int kSums = LANES == 16 ? 6 : LANES == 8 ? 3 : 1;
// Rows whose masks are read at once.
constexpr int kMasks = 256;

// output[row][column] = bias + sum_k input[row][k] kernel[k][column], for two vectors of columns from `column`.
template <int kWidth>
INLINE void multiply(const float* const* input, int64_t inputs, const float* kernel, const float* bias, int column,
                     Floats (*output)[2]) {
  const Floats bias0 = load(bias + column), bias1 = load(bias + column + LANES);
#pragma GCC unroll 8
  for (int row = 0; row < kBlock; ++row) {
    output[row][0] = bias0;
    output[row][1] = bias1;
  }
  for (int64_t k = 0; k < inputs; ++k) {
    const Floats kernel0 = load(kernel + k * kWidth + column), kernel1 = load(kernel + k * kWidth + column + LANES);
#pragma GCC unroll 8
    for (int row = 0; row < kBlock; ++row) {
      const Floats value = splat(input[row][k]);
      output[row][0] += value * kernel0;
      output[row][1] += value * kernel1;
    }
  }
}

// NaN stays NaN, since comparisons with it are false.
INLINE Floats relu(Floats value) { return larger(Floats{}, value); }

template <int kWidth>
INLINE void hidden_layer(const float* const* rows, const SetEncoder& a, float (*hidden)[kWidth]) {
  for (int column = 0; column < kWidth; column += 2 * LANES) {
    Floats sums[kBlock][2];
    multiply<kWidth>(rows, a.inputs, a.kernel1, a.bias1, column, sums);
#pragma GCC unroll 8
    for (int row = 0; row < kBlock; ++row) {
      store(hidden[row] + column, relu(sums[row][0]));
      store(hidden[row] + column + LANES, relu(sums[row][1]));
    }
  }
}

// The largest product of a set so far, in each column, and its row; NaN is larger than all.
template <int kWidth>
struct Maximum {
  static constexpr int kVectors = kWidth / LANES;
  Floats value[kVectors];
  Ints row[kVectors];

  __attribute__((always_inline)) void reset() {
    for (int i = 0; i < kVectors; ++i) {
      value[i] = splat(-kInfinity);
      row[i] = splat(int32_t{-1});
    }
  }

  __attribute__((always_inline)) void include(const float* products, int32_t number) {
    for (int i = 0; i < kVectors; ++i) {
      const Floats product = load(products + i * LANES);
      const Ints is_larger = (product > value[i]) | (product != product);
      value[i] = select(is_larger, product, value[i]);
      row[i] = select(is_larger, splat(number), row[i]);
    }
  }

  __attribute__((always_inline)) void write(const float* bias, float* output, int32_t* winner) const {
    for (int i = 0; i < kVectors; ++i) {
      const Floats sum = value[i] + load(bias + i * LANES);
      const Ints is_positive = sum > Floats{}, is_nan = sum != sum;
      store(output + i * LANES, relu(sum));
      store(winner + i * LANES, select(is_positive, row[i], select(is_nan, -2 - row[i], splat(int32_t{-1}))));
    }
  }
};

template <int kWidth>
static void encode(const SetEncoderForward& a, int64_t first, int64_t last) {
  alignas(64) static constexpr float kZero[kWidth] = {};
  alignas(64) float hidden[kBlock][kWidth], products[kBlock][kWidth];
  int64_t pending[kMasks + kBlock];
  int64_t count = 0, set = first;
  Maximum<kWidth> maximum;
  maximum.reset();
  const auto finish = [&](int64_t until) {
    for (; set < until; ++set) {
      maximum.write(a.bias2, a.output + set * kWidth, a.winner + set * kWidth);
      maximum.reset();
    }
  };
  const auto encode_block = [&](const int64_t* numbers, int size) {
    const float *rows[kBlock], *inputs[kBlock];
    for (int i = 0; i < kBlock; ++i) {
      rows[i] = a.rows + numbers[i < size ? i : 0] * a.inputs;
      inputs[i] = hidden[i];
    }
    hidden_layer<kWidth>(rows, a, hidden);
    for (int column = 0; column < kWidth; column += 2 * LANES) {
      Floats sums[kBlock][2];
      multiply<kWidth>(inputs, kWidth, a.kernel2, kZero, column, sums);
#pragma GCC unroll 8
      for (int i = 0; i < kBlock; ++i) {
        store(products[i] + column, sums[i][0]);
        store(products[i] + column + LANES, sums[i][1]);
      }
    }
    for (int i = 0; i < size; ++i) {
      finish(numbers[i] / a.count);
      maximum.include(products[i], (int32_t)(numbers[i] - set * a.count));
    }
  };
  const int64_t end = last * a.count;
  for (int64_t row = first * a.count; row < end;) {
    const int64_t stop = row + kMasks < end ? row + kMasks : end;
    for (; row < stop; ++row) {
      pending[count] = row;
      count += a.valid[row];
    }
    int64_t done = 0;
    for (; done + kBlock <= count; done += kBlock) encode_block(pending + done, kBlock);
    for (int64_t i = done; i < count; ++i) pending[i - done] = pending[i];
    count -= done;
  }
  if (count) encode_block(pending, (int)count);
  finish(last);
}

template <int kWidth>
static void differentiate(const SetEncoderBackward& a, int64_t first, int64_t last) {
  constexpr int kVectors = kWidth / LANES;
  alignas(64) float transposed[kWidth][kWidth], kernel2_gradient[kWidth][kWidth] = {};
  alignas(64) float hidden[kWidth + kBlock][kWidth], hidden_gradient[kWidth][kWidth];
  // Rows that won a maximum of the set, and for each column the place of its winner among them and its gradient.
  int32_t winners[kWidth], winner_of[kWidth];
  float gradient[kWidth];
  for (int k = 0; k < kWidth; ++k)
    for (int column = 0; column < kWidth; ++column) transposed[column][k] = a.kernel2[k * kWidth + column];
  for (int64_t i = 0; i < a.count; ++i) a.place[i] = -1;
  for (int64_t i = 0; i < a.inputs * kWidth; ++i) a.kernel1_gradient[i] = 0;
  for (int i = 0; i < kWidth; ++i) a.bias1_gradient[i] = a.bias2_gradient[i] = 0;

  for (int64_t set = first; set < last; ++set) {
    const float* rows = a.rows + set * a.count * a.inputs;
    int size = 0;
    for (int column = 0; column < kWidth; ++column) {
      const int32_t winner = a.winner[set * kWidth + column], row = winner < -1 ? -2 - winner : winner;
      winner_of[column] = -1;
      if (row < 0 || row >= a.count) continue;
      if (a.place[row] < 0) {
        a.place[row] = size;
        winners[size++] = row;
      }
      winner_of[column] = a.place[row];
      // As in XLA, NaN has no gradient, but products with zero show which weights and rows hold NaN.
      gradient[column] = winner < 0 ? 0 : a.gradient[set * kWidth + column];
    }
    if (!size) continue;

    for (int i = 0; i < size; i += kBlock) {
      const float* block[kBlock];
      for (int row = 0; row < kBlock; ++row) block[row] = rows + winners[i + row < size ? i + row : 0] * a.inputs;
      hidden_layer<kWidth>(block, a, hidden + i);
    }
    __builtin_memset(hidden_gradient, 0, sizeof(float) * kWidth * size);
    for (int column = 0; column < kWidth; ++column) {
      const int32_t row = winner_of[column];
      if (row < 0) continue;
      const Floats factor = splat(gradient[column]);
      a.bias2_gradient[column] += gradient[column];
#pragma GCC unroll 8
      for (int k = 0; k < kWidth; k += LANES) {
        float* sums = kernel2_gradient[column] + k;
        store(sums, load(sums) + factor * load(hidden[row] + k));
        store(hidden_gradient[row] + k, load(hidden_gradient[row] + k) + factor * load(transposed[column] + k));
      }
    }
    for (int i = 0; i < size; ++i) {
      a.place[winners[i]] = -1;
      for (int k = 0; k < kWidth; k += LANES) {
        const Floats passed = select(load(hidden[i] + k) > Floats{}, load(hidden_gradient[i] + k), Floats{});
        store(hidden_gradient[i] + k, passed);
        store(a.bias1_gradient + k, load(a.bias1_gradient + k) + passed);
      }
    }
    for (int64_t input = 0; input < a.inputs; input += kSums) {
      const int64_t left = a.inputs - input;
      Floats sums[kSums][kVectors];
      for (int i = 0; i < kSums; ++i)
        for (int k = 0; k < kVectors; ++k)
          sums[i][k] = i < left ? load(a.kernel1_gradient + (input + i) * kWidth + k * LANES) : Floats{};
      for (int row = 0; row < size; ++row) {
        const float* values = rows + winners[row] * a.inputs + input;
#pragma GCC unroll 8
        for (int i = 0; i < kSums; ++i) {
          const Floats value = splat(i < left ? values[i] : 0.0f);
          for (int k = 0; k < kVectors; ++k) sums[i][k] += value * load(hidden_gradient[row] + k * LANES);
        }
      }
      for (int i = 0; i < kSums && i < left; ++i)
        for (int k = 0; k < kVectors; ++k)
          store(a.kernel1_gradient + (input + i) * kWidth + k * LANES, sums[i][k]);
    }
  }
  for (int k = 0; k < kWidth; ++k)
    for (int column = 0; column < kWidth; ++column)
      a.kernel2_gradient[k * kWidth + column] = kernel2_gradient[column][k];
}

void encode_sets(const SetEncoderForward& arguments, int64_t first, int64_t last) {
  (arguments.width == 32 ? encode<32> : encode<64>)(arguments, first, last);
}

void differentiate_sets(const SetEncoderBackward& arguments, int64_t first, int64_t last) {
  (arguments.width == 32 ? differentiate<32> : differentiate<64>)(arguments, first, last);
}

}  // namespace drivax::TARGET

#else

namespace drivax {

// Takes the layers and the rows; the width is one of those that are compiled.
static void take_layers(Arrays& arrays, SetEncoder& a) {
  arrays.common(a.kernel1, {a.inputs, a.width});
  arrays.common(a.bias1, {a.width});
  arrays.common(a.kernel2, {a.width, a.width});
  arrays.common(a.bias2, {a.width});
  arrays.batched(a.rows, {a.count, a.inputs});
  arrays.require(a.width == 32 || a.width == 64, "compiled for layers of width 32 or 64");
}

static ffi::Error encode_sets(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  Arrays arrays(pool, arguments, results);
  SetEncoderForward a;
  take_layers(arrays, a);
  arrays.batched(a.valid, {a.count});
  arrays.batched(a.output, {a.width});
  arrays.batched(a.winner, {a.width});
  return arrays.run(32, [&](int64_t first, int64_t last) { CALL(encode_sets, a, first, last); });
}

static ffi::Error differentiate_sets(ffi::ThreadPool pool, ffi::RemainingArgs arguments, ffi::RemainingRets results) {
  Arrays arrays(pool, arguments, results);
  SetEncoderBackward a;
  take_layers(arrays, a);
  arrays.batched(a.winner, {a.width});
  arrays.batched(a.gradient, {a.width});
  arrays.common(a.kernel1_gradient, {a.inputs, a.width});
  arrays.common(a.bias1_gradient, {a.width});
  arrays.common(a.kernel2_gradient, {a.width, a.width});
  arrays.common(a.bias2_gradient, {a.width});
  // Sums over the batch, so in one part.
  return arrays.run(INT64_MAX, [&](int64_t first, int64_t last) {
    thread_local std::vector<int32_t> place;
    if ((int64_t)place.size() < a.count) place.resize(a.count);
    a.place = place.data();
    CALL(differentiate_sets, a, first, last);
  });
}

BIND(encode_sets)
BIND(differentiate_sets)

}  // namespace drivax

#endif
