#pragma once

namespace thrust {

template <class F, class I>
struct transform_iterator {
  I items;
  F f;
  auto operator[](long i) const { return f(items[i]); }
};
template <class F, class I>
transform_iterator<F, I> make_transform_iterator(I items, F f) {
  return {items, f};
}

}  // namespace thrust
