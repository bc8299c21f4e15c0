// The library: the instruction set in use, the names of its kernels, and the hash of sources and build.
#include <cstdlib>
#include <cstring>
#include <string>

#include "kernel.h"

namespace drivax {
namespace {

// The best target that the processor has, or the one that DRIVAX_NATIVE names if the processor has it.
Target find_target() {
  __builtin_cpu_init();
  Target best = kSse42;
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) best = kAvx2;
  if (best == kAvx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl"))
    best = kAvx512;
  const char* wish = std::getenv("DRIVAX_NATIVE");
  if (wish && !std::strcmp(wish, "sse4.2")) return kSse42;
  if (wish && !std::strcmp(wish, "avx2") && best == kAvx512) return kAvx2;
  return best;
}

std::string& names() {
  static std::string text;
  return text;
}

}  // namespace

const Target kTarget = find_target();

Name::Name(const char* name) { names().append(name).append(" "); }

}  // namespace drivax

#pragma GCC visibility push(default)
extern "C" {

// Names of all kernels, with a space after each.
const char* drivax_kernels() { return drivax::names().c_str(); }

const char* drivax_target() {
  return drivax::kTarget == drivax::kAvx512 ? "AVX-512" : drivax::kTarget == drivax::kAvx2 ? "AVX2" : "SSE4.2";
}

const char* drivax_hash() { return BUILD_HASH; }

}  // extern "C"
#pragma GCC visibility pop
