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
  int64_t batch, count, inputs, width;
};

struct SetEncoderForward : SetEncoder {
  const bool* valid;  // [batch, count]
  float* output;      // [batch, width]
  int32_t* winner;    // [batch, width]: row of the maximum; -1 if the output is 0
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

template <int kWidth>
INLINE void hidden_layer(const float* const* rows, const SetEncoder& a, float (*hidden)[kWidth]) {
  for (int column = 0; column < kWidth; column += 2 * LANES) {
    Floats sums[kBlock][2];
    multiply<kWidth>(rows, a.inputs, a.kernel1, a.bias1, column, sums);
#pragma GCC unroll 8
    for (int row = 0; row < kBlock; ++row) {
      store(hidden[row] + column, larger(sums[row][0], Floats{}));
      store(hidden[row] + column + LANES, larger(sums[row][1], Floats{}));
    }
  }
}

// The largest product of a set so far, in each column, and its row.
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
      const Ints is_larger = product > value[i];
      value[i] = select(is_larger, product, value[i]);
      row[i] = select(is_larger, splat(number), row[i]);
    }
  }

  __attribute__((always_inline)) void write(const float* bias, float* output, int32_t* winner) const {
    for (int i = 0; i < kVectors; ++i) {
      const Floats sum = value[i] + load(bias + i * LANES);
      const Ints is_positive = sum > Floats{};
      store(output + i * LANES, select(is_positive, sum, Floats{}));
      store(winner + i * LANES, select(is_positive, row[i], splat(int32_t{-1})));
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
  // Rows that won a maximum of the set, and for each column the place of its winner among them.
  int32_t winners[kWidth], winner_of[kWidth];
  for (int k = 0; k < kWidth; ++k)
    for (int column = 0; column < kWidth; ++column) transposed[column][k] = a.kernel2[k * kWidth + column];
  for (int64_t i = 0; i < a.count; ++i) a.place[i] = -1;
  for (int64_t i = 0; i < a.inputs * kWidth; ++i) a.kernel1_gradient[i] = 0;
  for (int i = 0; i < kWidth; ++i) a.bias1_gradient[i] = a.bias2_gradient[i] = 0;

  for (int64_t set = first; set < last; ++set) {
    const float* rows = a.rows + set * a.count * a.inputs;
    const float* gradient = a.gradient + set * kWidth;
    int size = 0;
    for (int column = 0; column < kWidth; ++column) {
      const int32_t row = a.winner[set * kWidth + column];
      if (row >= 0 && a.place[row] < 0) {
        a.place[row] = size;
        winners[size++] = row;
      }
      winner_of[column] = row < 0 ? -1 : a.place[row];
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

template <typename Arguments>
static void set_encoder(Arguments& a, const Float& rows, const Float& kernel1, const Float& bias1, const Float& kernel2,
                 const Float& bias2) {
  const auto shape = rows.dimensions();
  a.rows = rows.typed_data();
  a.kernel1 = kernel1.typed_data();
  a.bias1 = bias1.typed_data();
  a.kernel2 = kernel2.typed_data();
  a.bias2 = bias2.typed_data();
  a.inputs = shape[shape.size() - 1];
  a.count = shape[shape.size() - 2];
  a.batch = rows.element_count() / (a.inputs * a.count);
  a.width = bias1.element_count();
}

static ffi::Error encode_sets(ffi::ThreadPool pool, Float kernel1, Float bias1, Float kernel2, Float bias2, Float rows,
                       Bool valid, Result<Float> output, Result<Int> winner) {
  SetEncoderForward a;
  set_encoder(a, rows, kernel1, bias1, kernel2, bias2);
  a.valid = valid.typed_data();
  a.output = output->typed_data();
  a.winner = winner->typed_data();
  divide(pool, a.batch, 32, [&](int64_t first, int64_t last) { CALL(encode_sets, a, first, last); });
  return ffi::Error::Success();
}

static ffi::Error differentiate_sets(Float kernel1, Float bias1, Float kernel2, Float bias2, Float rows, Int winner,
                              Float gradient, Result<Float> kernel1_gradient, Result<Float> bias1_gradient,
                              Result<Float> kernel2_gradient, Result<Float> bias2_gradient) {
  SetEncoderBackward a;
  set_encoder(a, rows, kernel1, bias1, kernel2, bias2);
  a.winner = winner.typed_data();
  a.gradient = gradient.typed_data();
  a.kernel1_gradient = kernel1_gradient->typed_data();
  a.bias1_gradient = bias1_gradient->typed_data();
  a.kernel2_gradient = kernel2_gradient->typed_data();
  a.bias2_gradient = bias2_gradient->typed_data();
  thread_local std::vector<int32_t> place;
  if ((int64_t)place.size() < a.count) place.resize(a.count);
  a.place = place.data();
  CALL(differentiate_sets, a, 0, a.batch);
  return ffi::Error::Success();
}

BIND(encode_sets, encode_sets,
     .Ctx<ffi::ThreadPool>().Arg<Float>().Arg<Float>().Arg<Float>().Arg<Float>().Arg<Float>().Arg<Bool>()
     .Ret<Float>().Ret<Int>())
BIND(differentiate_sets, differentiate_sets,
     .Arg<Float>().Arg<Float>().Arg<Float>().Arg<Float>().Arg<Float>().Arg<Int>().Arg<Float>()
     .Ret<Float>().Ret<Float>().Ret<Float>().Ret<Float>())

}  // namespace drivax

#endif
