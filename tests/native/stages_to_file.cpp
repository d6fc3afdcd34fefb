// Write the results of the CPU's stages to a file, which tests/native/test_elsewhere.py reads. Each result is a line with its
// name, the bytes of a number and the count of the numbers, then the numbers. The program uses the vectors that every
// processor of the kind has; their name is the first line.
#include <cstdio>
#include <fstream>

#include "hwy/highway.h"
#include "native/render.h"

namespace lfgs {
namespace {

template <class T>
void write(std::ostream& file, const std::string& name, const std::vector<T>& numbers) {
  file << name << " " << sizeof(T) << " " << numbers.size() << "\n";
  file.write(reinterpret_cast<const char*>(numbers.data()), std::streamsize(numbers.size() * sizeof(T)));
}

template <class T>
void write_all(std::ostream& file) {
  Render<T> render(2);
  render.record("means", render.means), render.record("quaternions", render.quaternions);
  render.record("scales", render.scales), render.record("opacities", render.opacities);
  render.record("sh", render.sh), render.record("gradient", render.gradient);
  render.run();
  for (const auto& [name, numbers] : render.results) write(file, name, numbers);
}

}  // namespace
}  // namespace lfgs

int main(int count, char** arguments) {
  if (count != 2) return std::fputs("usage: stages_to_file FILE\n", stderr), 2;
  std::ofstream file(arguments[1], std::ios::binary);
  file << hwy::TargetName(HWY_STATIC_TARGET) << "\n";
  lfgs::write_all<float>(file), lfgs::write_all<double>(file);
  return file.flush() ? 0 : 1;
}
