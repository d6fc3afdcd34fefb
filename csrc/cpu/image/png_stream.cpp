// The rows of a PNG as a zlib stream, several times as fast as by zlib, which looks for more than there is.
#include <bit>
#include <cstring>

#include "cpu/image/huffman.h"
#include "stages/image.h"

namespace lfgs {
namespace {

constexpr int64_t kBlockBytes = 1 << 18;  // about what has codes of its own, and stays in the cache
constexpr int kUp = 2, kEnd = 256, kSymbols = 286, kLeastRun = 3, kMostRun = 258;
constexpr int kTokens = kEnd + kMostRun + 1;  // a byte by its value, a run of n bytes by kEnd + n

// The symbol of a run of each length, and the bits that follow it (RFC 1951, section 3.2.5).
struct RunSymbol {
  int symbol, extra_bits, extra;
};
std::array<RunSymbol, kMostRun + 1> run_symbols() {
  std::array<RunSymbol, kMostRun + 1> runs{};
  int symbol = 257, length = kLeastRun;
  for (; length < kMostRun; symbol++) {
    const int bits = symbol < 265 ? 0 : (symbol - 261) / 4;
    for (int extra = 0; extra < 1 << bits && length < kMostRun; extra++) runs[length++] = {symbol, bits, extra};
  }
  runs[kMostRun] = {kSymbols - 1, 0, 0};
  return runs;
}
const std::array<RunSymbol, kMostRun + 1> kRuns = run_symbols();

// The checksum of RFC 1950, section 8.2.
class Adler {
 public:
  void add(const uint8_t* bytes, int64_t count) {
    for (; count > 0; bytes += kAtOnce, count -= kAtOnce) {
      const auto n = static_cast<uint32_t>(std::min<int64_t>(count, kAtOnce));
      uint32_t sum = 0, weighted = 0;
      for (uint32_t i = 0; i < n; i++) {
        sum += bytes[i];
        weighted += (n - i) * bytes[i];
      }
      high_ = (high_ + uint64_t{n} * low_ + weighted) % kPrime;
      low_ = (low_ + sum) % kPrime;
    }
  }
  uint32_t value() const { return static_cast<uint32_t>(high_ << 16 | low_); }

 private:
  static constexpr uint32_t kPrime = 65521, kAtOnce = 5552;  // so many weighted bytes fit 32 bits
  uint64_t low_ = 1, high_ = 0;
};

// Bits one after the other, the first one lowest.
class Bits {
 public:
  std::vector<uint8_t> bytes;
  // Makes room for so many bits more, and a word that is written as a whole.
  void reserve(uint64_t bits) { bytes.resize(used_ + bits / 8 + 2 * sizeof(uint64_t)); }
  // At most 56 - 7 at a time.
  void put(uint64_t bits, int count) {
    held_ |= bits << held_bits_;
    held_bits_ += count;
    if constexpr (std::endian::native == std::endian::little) {
      std::memcpy(bytes.data() + used_, &held_, sizeof held_);
    } else {
      for (int byte = 0; byte < 8; byte++) bytes[used_ + byte] = static_cast<uint8_t>(held_ >> 8 * byte);
    }
    used_ += held_bits_ >> 3;
    held_ >>= held_bits_ & ~7;
    held_bits_ &= 7;
  }
  // Fills up the last byte, and gives back what was reserved.
  void end() {
    if (held_bits_ > 0) put(0, 8 - held_bits_);
    bytes.resize(used_);
  }

 private:
  size_t used_ = 0;
  uint64_t held_ = 0;
  int held_bits_ = 0;
};

// Whether kLeastRun bytes from `at` on are as the one before. One more may be read.
bool begins_run(const uint8_t* at) {
  uint32_t before, here;
  std::memcpy(&before, at - 1, sizeof before);
  std::memcpy(&here, at, sizeof here);
  constexpr uint32_t three = std::endian::native == std::endian::little ? 0x00ffffff : 0xffffff00;
  return ((before ^ here) & three) == 0;
}

// How many bytes from `at` on are as the one before, up to `most`. Eight more may be read.
int run_length(const uint8_t* at, int64_t most) {
  const uint64_t same = at[-1] * uint64_t{0x0101010101010101};
  int64_t run = 0;
  for (; run < most; run += 8) {
    uint64_t word;
    std::memcpy(&word, at + run, sizeof word);
    if (word ^= same; word != 0) {
      const bool little = std::endian::native == std::endian::little;
      run += (little ? std::countr_zero(word) : std::countl_zero(word)) / 8;
      break;
    }
  }
  return static_cast<int>(std::min(run, most));
}

class Block {
 public:
  // bytes: the filtered rows of the block, behind which eight more can be read.
  Block(const uint8_t* bytes, int64_t count) {
    tokens_.resize(count + 1);
    uint16_t* token = tokens_.data();
    *token++ = bytes[0];
    for (int64_t i = 1; i < count;) {
      const int64_t most = std::min<int64_t>(kMostRun, count - i);
      if (most < kLeastRun || !begins_run(bytes + i)) {
        *token++ = bytes[i++];
        continue;
      }
      const int run = run_length(bytes + i, most);
      *token++ = static_cast<uint16_t>(kEnd + run);
      i += run;
    }
    *token++ = kEnd;
    tokens_.resize(token - tokens_.data());
  }

  void write(Bits& out, bool is_last) const {
    std::array<uint32_t, kTokens> tokens{};
    for (const uint16_t token : tokens_) tokens[token]++;
    std::array<uint32_t, kSymbols> counts{};
    for (int token = 0; token < kTokens; token++)
      counts[token <= kEnd ? token : kRuns[token - kEnd].symbol] += tokens[token];
    const auto lengths = code_lengths(counts);
    const auto codes = codes_of(lengths);
    struct Word {
      uint32_t bits, count;
    };
    std::array<Word, kTokens> words{};
    uint64_t total = kHeaderBits;
    for (int token = 0; token < kTokens; token++) {
      if (tokens[token] == 0) continue;
      if (token <= kEnd) {
        words[token] = {codes[token], lengths[token]};
      } else {  // after the extra bits one more for the distance of 1, the only one that there is
        const auto [symbol, extra_bits, extra] = kRuns[token - kEnd];
        words[token] = {codes[symbol] | static_cast<uint32_t>(extra) << lengths[symbol],
                        lengths[symbol] + extra_bits + 1u};
      }
      total += uint64_t{tokens[token]} * words[token].count;
    }
    out.reserve(total);
    put_header(out, is_last, lengths);
    for (const uint16_t token : tokens_) out.put(words[token].bits, static_cast<int>(words[token].count));
  }

 private:
  static constexpr int kHeaderBits = 3 + 14 + 3 * 19 + 4 * (kSymbols + 1);
  std::vector<uint16_t> tokens_;

  // RFC 1951, section 3.2.7. The lengths are stored with four bits each: of a block of this size that is next to
  // nothing.
  static void put_header(Bits& out, bool is_last, const std::array<uint8_t, kSymbols>& lengths) {
    out.put(is_last, 1);
    out.put(2, 2);
    out.put(kSymbols - 257, 5);
    out.put(0, 5);
    out.put(19 - 4, 4);
    for (int k = 0; k < 19; k++) out.put(k < 3 ? 0 : 4, 3);  // the first three are of repetitions
    const auto put = [&](int length) {
      out.put((length & 1) << 3 | (length & 2) << 1 | (length & 4) >> 1 | (length & 8) >> 3, 4);
    };
    for (const uint8_t length : lengths) put(length);
    put(1);
  }
};

}  // namespace

std::vector<uint8_t> png_stream(const uint8_t* pixels, int64_t rows, int64_t row_bytes) {
  Bits out;
  Adler adler;
  out.reserve(16);
  out.put(0x0178, 16);
  const int64_t each = std::max<int64_t>(1, kBlockBytes / (row_bytes + 1));
  const std::vector<uint8_t> none(row_bytes, 0);
  std::vector<uint8_t> filtered(each * (row_bytes + 1) + sizeof(uint64_t));
  for (int64_t first = 0; first < rows; first += each) {
    const int64_t beyond = std::min(rows, first + each);
    uint8_t* to = filtered.data();
    for (int64_t row = first; row < beyond; row++, to += row_bytes) {
      const uint8_t* here = pixels + row * row_bytes;
      const uint8_t* above = row == 0 ? none.data() : here - row_bytes;
      *to++ = kUp;
      for (int64_t i = 0; i < row_bytes; i++) to[i] = static_cast<uint8_t>(here[i] - above[i]);
    }
    const int64_t count = to - filtered.data();
    adler.add(filtered.data(), count);
    Block(filtered.data(), count).write(out, beyond == rows);
  }
  out.end();
  for (int shift = 24; shift >= 0; shift -= 8) out.bytes.push_back(static_cast<uint8_t>(adler.value() >> shift));
  return out.bytes;
}

}  // namespace lfgs
