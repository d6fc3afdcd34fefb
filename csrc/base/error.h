// The one exception of the core; bind/ turns it into a Python ValueError.
#pragma once

#include <stdexcept>
#include <string>

namespace lfgs {

struct Error : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// Throws with the message when the condition does not hold.
inline void require(bool condition, const std::string& message) {
  if (!condition) throw Error(message);
}

}  // namespace lfgs
