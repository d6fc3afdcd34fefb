// How a composite is called for the vectors of this machine. Highway compiles it once for every vector instruction set
// (HWY_NAMESPACE). At run time it chooses among functions that are not templates. Double precision, which only checks
// others, is compiled once, for the set that every processor has.
#pragma once

// To be used in HWY_NAMESPACE, after the template Counters Name(const Job<T>&).
#define LFGS_FOR_EVERY_TARGET(Name, Job) \
  Counters Name##F32(const Job<float>& job) { return Name(job); }

// To be used once, in an unnamed namespace. Defines Counters dispatch(const Job<T>&), which calls the best target.
#define LFGS_DISPATCH(Name, Job)                                                            \
  HWY_EXPORT(Name##F32);                                                                    \
  Counters dispatch(const Job<float>& job) { return HWY_DYNAMIC_DISPATCH(Name##F32)(job); } \
  Counters dispatch(const Job<double>& job) { return HWY_STATIC_DISPATCH(Name)(job); }
