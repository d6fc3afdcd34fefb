// The CPU's stages on several threads, and two renders at a time: for the thread sanitizer, which stops at the first
// race. Prints what it drew; fails where threads change it.
#include <cstdio>
#include <cstring>
#include <thread>

#include "native/render.h"

namespace lfgs {
namespace {

template <class T>
bool same_on_any_number_of_threads() {
  Render<T> one(1), two(4), three(3);
  one.run();
  std::thread beside([&] { three.run(); });
  two.run();
  beside.join();
  size_t numbers = 0;
  for (const auto& [name, values] : one.results) numbers += values.size();
  auto same = [&](const Render<T>& other) {
    bool equal = one.results.size() == other.results.size();
    for (size_t i = 0; equal && i < one.results.size(); ++i) {
      const std::vector<T>&a = one.results[i].second, &b = other.results[i].second;
      equal = a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0;
    }
    return equal;
  };
  std::printf("%zu numbers of %zu bytes, %s\n", numbers, sizeof(T),
              same(two) && same(three) ? "the same bits on 1, 3 and 4 threads" : "DIFFERENT");
  return same(two) && same(three);
}

}  // namespace
}  // namespace lfgs

int main() {
  const bool same = lfgs::same_on_any_number_of_threads<float>();
  return lfgs::same_on_any_number_of_threads<double>() && same ? 0 : 1;
}
