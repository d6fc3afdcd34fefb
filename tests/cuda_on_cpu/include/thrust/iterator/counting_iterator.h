#pragma once

namespace thrust {

template <class T>
struct counting_iterator {
  T first;
  explicit counting_iterator(T first_) : first(first_) {}
  T operator[](T i) const { return first + i; }
};

}  // namespace thrust
